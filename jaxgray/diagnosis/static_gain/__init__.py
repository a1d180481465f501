"""Quasi-static records: y = offset + G (u + effects at the inputs).

regression  gain, offset and effects by least squares
search      which effects are in the model
"""
