"""Models wired to a system, and the nanopositioner made of them."""
