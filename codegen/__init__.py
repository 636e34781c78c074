"""What ships: C projects of one observer step."""
