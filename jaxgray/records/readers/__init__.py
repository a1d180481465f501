"""From files and tables in memory to named columns of numbers, one format a module."""
