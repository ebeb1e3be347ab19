"""Where fits begin: from loops, from frequency responses, from ordinary values."""
