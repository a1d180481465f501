"""The backend and what it compiles.

backend             releases, flags, cores, the self-test
runtime             64-bit floats and memory, checked before work begins
stored_programs     compiled programs kept whole on disk
compilation_cache   the cache of jax beside them
kept_files          files that nobody else could have changed
read_ahead          stored programs read before they are asked for
result_forms        what a stored program returns, in words
side_by_side        independent work on several cores
"""
