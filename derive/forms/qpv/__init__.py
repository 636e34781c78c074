"""What is the plant when products of states are kept? Its quadratic form."""
