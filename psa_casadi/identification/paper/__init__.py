"""The paper's own identification, section 3: moments of a step, zero crossings of loops."""
