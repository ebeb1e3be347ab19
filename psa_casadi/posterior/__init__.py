"""Posteriors: draws of all that records leave open, by NUTS on the fit's exact gradients."""
