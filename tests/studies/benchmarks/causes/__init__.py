"""Records with hidden causes as a data set on which any method can be scored, without this code."""
