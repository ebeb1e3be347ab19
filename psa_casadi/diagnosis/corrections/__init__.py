"""Unnamed corrections: generic forms at every port that keep the names of effects honest."""
