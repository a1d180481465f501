"""Starting models, judged alike by free-run simulation.

start          subspace and regression starts
selection      which starts are refined
regression     the equation of motion as a regression in the λ-domain
modal_start    modes one by one, then the nearest mechanical system
base_start     M, D, K under base excitation, mode by mode
rigid          records whose free run measures drift
physical_grid  M, D, K of a whole grid of realisations
guard          whether a refinement lost on held-out data
"""
