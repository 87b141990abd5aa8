"""The paper's method: Welch estimate, fits of Eq. (26) with two weightings, indices."""
