"""The search for causes: candidates fitted, compared and chosen."""
