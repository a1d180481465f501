"""Which effects are in the model.

state         how far the search got
forward       rounds: screen, refit, accept
acceptance    whether a refit is taken
confusable    look-alikes, and nested laws whose further parameters do not pay
provisional   laws that gain only together with a second one
backward      unite, drop and simplify after an acceptance
final_swap    every class tested once more in the whole model
long_records  the search on a part of long records, carried over to the whole
modal_restart a single finding refitted from the record's own modes
"""
