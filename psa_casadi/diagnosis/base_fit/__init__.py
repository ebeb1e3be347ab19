"""The base model fitted again where it was lost: its resonances and their ringing."""
