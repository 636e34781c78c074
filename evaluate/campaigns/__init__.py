"""Many runs: over seeds, scenarios, truths and designs."""
