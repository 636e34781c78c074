"""How few vertices will do? Smaller polytopes of Jacobians, and what they give up."""
