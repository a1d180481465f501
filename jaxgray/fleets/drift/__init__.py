"""The same machine recorded again and again: what has moved, when, by how much.

series       which machine, when, under which conditions
"""
