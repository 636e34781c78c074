"""What is the plant as A(rho) x + B(rho) u? Its quasi-LPV form, with scheduling ranges."""
