"""Where a refit can begin, besides the weights of the score test.

first_states    the linear model itself, of a body that nothing holds
user_model      wrong entries of the user's own model
force_matching  a law that imitates the force of another
lookalikes      confusable laws from the best one's end
equation_error  laws that the force equation finds, or tries first, with its M, D, K
multiple_shooting  refits to windows of a record together
other_models    laws about other linear models of the record than the best one
residual_modes  hidden modes from the lines of the residual
windows         changes of a parameter over time, from linear models of the windows of a record
"""
