"""What each effect would add to the base model, before it is fitted."""
