"""Records without noise: M, D, K from the subspace start alone, to 1e-7."""
