"""What every method shares: the observer, its certificate, its file, its step."""
