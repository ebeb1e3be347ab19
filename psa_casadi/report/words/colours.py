"""The colours of models, noise and axes in every picture, and what takes their place at night."""

MEASURED, BASE, EXTENDED = "#3a3a3a", "#d55e00", "#0072b2"
NOISE, HELD_OUT = "#8a8a8a", "#f3e9c4"
INK, GRID, AXIS = "#222222", "#e4e7ea", "#9aa1a8"
WEAK, BOUND = "#e69f00", "#a8568f"

#: What takes a colour's place on a dark screen. Every colour in a plot is a key of this table.
DARK = {
    INK: "#e4e6e8",
    GRID: "#2c343b",
    AXIS: "#69747e",
    MEASURED: "#d9dcdf",
    BASE: "#ff8a45",
    EXTENDED: "#56b4e9",
    NOISE: "#8f979e",
    HELD_OUT: "#3a3521",
    WEAK: "#f0b849",
    BOUND: "#d58abd",
}
