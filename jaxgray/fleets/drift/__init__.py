"""The same machine recorded again and again: what has moved, when, by how much.

series       which machine, when, under which conditions
score        local statistic of a record at a reference model
changes      steps and ramps in a series of estimates
machines     references, tests over all machines and parameters, causes
shown        the result on the page and in JSON
"""
