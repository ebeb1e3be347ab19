"""A stack followed while it works: observers and recursive least squares."""
