"""What FMU, Modelica and SSP share: the table of variables, markup, the icon."""
