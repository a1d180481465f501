"""Which effects are in the model: forward selection under the simulation error, measured minus free run.

A state is a set of effects at places, refitted together with M, D, K and the first states. The first state has none.
Every round:

    Screen    the score test of every effect, place and shape on the residual of the state
    Propose   the best few candidates, each at its best places, and the look-alikes of the best
    Refit     every candidate from all starts that apply; its best end counts
    Order     by BIC, all refits under the noise model of the best; a law that contains another must pay for more
    Accept    the first that passes the one rule (`diagnosis.acceptance`): significant, not at a bound, not another law
              in disguise, explains a tenth of the error above the noise that the state leaves, and lowers the error on
              held-out data for sure
    Compare   those within ΔBIC 6 of it (10 for look-alikes) stand beside it as equivalent
    Prune     effects that it made needless are dropped or united with it; the next round begins

Where no candidate passes, the round goes on with other proposals, in this order: laws other than those that failed in
it; hidden modes; candidates refitted under white noise; candidates refused only because size and shape were uncertain
together; two effects that gain only together. The search ends where the score test is silent, where these pass no
more either, or where `max_effects` are in. At the end the members of every equivalence are compared once more in the
whole model.

state         how far the search got
forward       the rounds
proposals     what a round refits
acceptance    the evidence for one refit, and its gain on held-out data
confusable    look-alikes, and laws that contain another and add nothing
provisional   laws that gain only together with a second one
backward      unite, drop and simplify after an acceptance
final_swap    equivalent laws compared once more in the whole model
parts         the search on a part of a long record, carried over to the whole; out of step, by the force equation first
restart       the model refitted for the free run where it leaves more than noise, or from the record's own modes

To add an effect: a class in `mechanics.effects`, and its row in `mechanics.effects.CATALOGUE`. To add a start: a
module in `diagnosis.starts`, and its line in `search.proposals.refitted`. To add a move: a function here that gives
refits, its line in `search.forward._round`, and its name in `diagnosis.findings.Move`. To add a likelihood: a folder
beside `diagnosis.equation_error` whose search is an `AbstractSelection` (`diagnosis.selection`), and its line in
`diagnosis.routing`.
"""
