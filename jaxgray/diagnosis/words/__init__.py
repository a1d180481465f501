"""Sentences and titles, by which a person reads a result.

sentences  the verdict and the description of a diagnosis
titles     names of effects and places, values with their errors
"""
