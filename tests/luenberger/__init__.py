"""A Luenberger observer with a peak bound: the smallest method that keeps the whole contract.

    e = x - xhat,  e+ = (A + M - L C) e + (W1 - L W2) w,  M in the family of Jacobians of g,
    |e| <= s elementwise, s+ = N s + n,  N >= |A + M - L C|,  n >= |W1 - L W2| |w|,

so that s stays below b once N b + n <= b: the peak bound. For discrete-time plants without faults
and unknown inputs; CONTRIBUTING.md goes through its files.
"""
