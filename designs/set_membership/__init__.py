"""Set-membership observer: boxes contracted over the equations, and zonotopes between them."""
