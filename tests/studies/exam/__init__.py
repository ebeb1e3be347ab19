"""Plants of another author: an exam of the diagnosis that its makers did not set.

A simulator in NumPy and SciPy that shares no code with psa_casadi nor with the plants of
`tests/studies/plants`, written apart from both. Its stacks have hysteresis of six kinds, its causes
other forms than the effects of the package, its voltages are what laboratories play.
"""
