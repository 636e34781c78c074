"""Varying-parameter forms of a plant: quasi-LPV and QPV."""
