"""Quasi-static records: y = offset + G (u + effects at the inputs).

regression  gain, offset and effects by least squares
springs     bodies on springs that are not linear
search      which effects are in the model
"""
