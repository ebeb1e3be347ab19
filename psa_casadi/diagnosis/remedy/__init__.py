"""How large an effect is for one stack, in tests that anyone can repeat on the device."""
