"""A model in a page: compiled to WebAssembly, and described for its sliders."""
