"""What a discretisation leaves out, enclosed."""
