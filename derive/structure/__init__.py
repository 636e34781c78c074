"""What structure allows: ranks, zeros, detectability, isolability, excitation."""
