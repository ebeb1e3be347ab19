"""What the package promises its users, by its public names and its command alone."""
