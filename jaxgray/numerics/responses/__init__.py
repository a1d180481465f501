"""Linear responses to series.

lifting             many samples at a time
varying_steps       steps of lengths of their own
sensitivity         derivatives of responses
response_products   sums of products of these, without them
filters             filters of signals
band_limited        what lies between samples
"""
