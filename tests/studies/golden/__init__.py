"""Golden answers: what the package says of fixed cases, kept as text, and what has changed of it.

    python -m tests.studies.golden [--only PATTERN] [--twelfth] [--accept] [--workers N]

The cases use `psa_casadi` alone, and records that share no code with it.
"""
