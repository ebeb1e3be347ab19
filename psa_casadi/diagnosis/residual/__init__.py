"""What is left of a record: views, spectrum, harmonics, and each effect's signature."""
