"""Prediction-error fits: unknowns, predictions with derivatives, least squares."""
