"""The page: one file, offline.

whole                                    the page of any result
identification, diagnosis                their parts
identification_plots, diagnosis_plots    and plots
parts                                    tables, plots and axes that all share
records                                  what is told of the data
time_plots, frequency_responses          curves over time and frequency
binning                                  long curves drawn with few points
"""
