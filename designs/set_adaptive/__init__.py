"""Set adaptive observer."""
