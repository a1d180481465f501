"""Linear algebra.

linear_algebra       factors, solutions, projections
matrix_exponential, matrix_logarithm, riccati
positive             conic programs over positive matrices
bounded              whether numbers are finite and of some size
namespace            numpy or jax, as the arrays are
"""
