"""Golden answers: the answers of the package to fixed cases, kept as text, and their changes.

    python -m tests.studies.golden [--only PATTERN] [--twelfth] [--accept] [--workers N]

The cases use `psa_casadi` alone, and records that share no code with it.
"""
