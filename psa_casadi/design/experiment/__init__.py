"""What to measure next: voltages that separate causes and settle parameters."""
