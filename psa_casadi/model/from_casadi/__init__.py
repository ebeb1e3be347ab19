"""Models from one's own CasADi equations."""
