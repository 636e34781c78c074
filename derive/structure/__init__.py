"""What can be seen and told apart at all? Decoupling, zeros, detectability, faults."""
