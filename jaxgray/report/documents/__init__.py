"""Results as documents.

identification, diagnosis    what a document says of them
catalogue                    of the effects that are looked for
export                       plain values, JSON, models saved and loaded
simulated                    simulated outputs as a file
terms                        laws and their parameters
columns                      names of columns in files
"""
