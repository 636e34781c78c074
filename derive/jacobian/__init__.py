"""How much does the plant change between two points? Jacobians over the box, as a family."""
