"""Exact steps of the linear part: the split of a model, its C code, and the runs."""
