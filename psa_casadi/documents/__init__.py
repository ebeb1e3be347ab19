"""What commands write as JSON, and the schemas of it."""
