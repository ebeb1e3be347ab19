"""A diagnosis or an identification as text, picture and page; nothing is computed here."""
