"""Generic effects of any model: what may be missing at its inputs, outputs and rates."""
