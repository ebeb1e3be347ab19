"""Exact steps of many sets of parameters on a GPU, where there is one."""
