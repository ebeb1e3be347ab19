"""How to mount a stack: preload, stiffness and the loop around it."""
