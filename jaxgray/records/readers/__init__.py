"""From files and tables in memory to named columns of numbers, one format a module.

table       named columns of numbers, as every reader returns them
limits      how much a file may ask for
memory      data frames, xarray objects and other tables in memory
delimited   delimited text
matlab      MATLAB files up to version 7
hdf5        HDF5, and MATLAB files of version 7.3
containers  arrays by name: npz, npy, mat
parquet     Parquet
universal   universal files of modal testing
chunks      a file in chunks, for records longer than memory
"""
