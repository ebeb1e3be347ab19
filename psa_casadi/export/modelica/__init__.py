"""A model as a Modelica package."""
