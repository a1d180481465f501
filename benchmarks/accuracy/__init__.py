"""Rows of `identification_accuracy.py`."""
