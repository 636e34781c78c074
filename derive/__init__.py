"""What follows from a plant, with proof."""
