"""Voltages that follow a path or reach a place soonest, within the amplifier's limits."""
