"""What other rooms compute with, and what knows nothing of mechanics.

programs      the backend, compiled programs and their files
responses     linear responses to series, and their derivatives
matrices      linear algebra, cones of positive matrices
outcomes      how a computation ended, and its errors
progress      how far it is, and within which time
text, notebook, data_frames    words, tables in notebooks, tables of pandas
whole_files   files that are written whole or not at all
"""
