"""What is estimated, on what, and its simulation.

candidate         records padded to few sizes, parametrisation, candidate
parameter_vector  the vector that a refit moves
simulator         free run and Jacobian of a candidate
reversals         samples of accelerometers that no simulation of dry friction decides
free_run          free run over data with a first state fitted to their head
held_out_gain     gain of one free run over another, with its interval
own_laws          laws that a given model has already
baseline          the model that a diagnosis starts from
compile_ahead     programs of a diagnosis compiled in a second thread
"""
