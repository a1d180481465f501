"""Which effects are in the model: forward selection by the simulation error, measured outputs minus simulated ones.

A *structure* is a set of effects. Each has a place (a coordinate or two, an input, an output) and a shape (the values
of the parameters that enter its law nonlinearly, such as a threshold). A *refit* of it estimates M, D, K, initial
states and the parameters of all effects together. The search begins with the structure without effects. Every round:

    Screen    the score test of every effect, at every place, in every shape, on the residual of the present structure
    Propose   the few effects that score highest, each at its likeliest places, and every look-alike of the best one
    Refit     each of them from every start that applies (`diagnosis.starts`); the best end of each counts
    Order     by BIC, all under the noise model of the best refit; a law that contains a simpler one must beat it by
              more than its further parameters gain by chance
    Accept    the first that passes the rule of `diagnosis.acceptance`: significant, no parameter at a bound, not
              reduced to another law by its values, a tenth of the residual above the noise removed, and a gain on
              held-out data (99 % sure)
    Compare   refits within ΔBIC 6 of the accepted one (look-alikes: 10) form its equivalence class
    Prune     an accepted law that the new one contains is united with it, and needless laws are dropped; where neither
              happens, simpler laws replace those that hardly differ from them; then the next round

Where no candidate passes, the round makes other *moves*, in this order:

    1   a second score test, without the effects that failed in this round
    2   hidden modes, at lines in the spectrum of the residual
    3   candidates refitted under white noise, those of this round among them
    4   the best candidate that fails for its gain on held-out data alone: kept provisionally until a second one gains
        together with it, else withdrawn

The search ends where the score test shows nothing, where no move passes, or with `max_effects` effects. Then the
members of every equivalence class are compared once more in the whole model.

state         the search state: structure, refit, what was accepted, what was refused and why
forward       the rounds
proposals     which candidates a round refits, from which starts; candidates of moves 1 and 3
acceptance    what a refit has to show for the rule: evidence, and gain on held-out data
confusable    look-alikes, and laws that contain another and add nothing
provisional   move 4
backward      unite, drop and simplify after an acceptance
final_swap    members of an equivalence class compared once more in the whole model
parts         the search on a part of a long record, its findings refitted on the whole; and whether the free run loses
              phase with the record: then candidates come from the force equation
restart       the accepted model refitted under white noise, or from the modes of the record; kept if it leaves less

To add an effect: in the file of its family in `mechanics.effects` a class that declares what it `contains` and
`resembles`; its row in `mechanics.effects.CATALOGUE`; its name for readers in `diagnosis.words.titles.NAMES`.
To add a start (it may propose laws, too): a module in `diagnosis.starts` with a function that gives refitted
candidates, as in `starts.other_models`; its line in `search.proposals.refitted`.
To add a move: a module here with a function that gives refitted candidates; its name in `diagnosis.findings.Move`; its
line in `search.forward._round`, or in `search.backward.prune` where it changes what was accepted already.
To add a likelihood: a folder beside `diagnosis.equation_error` with a class derived from
`diagnosis.selection.AbstractSelection`, which does the rounds and the acceptance of likelihoods whose refits cost
little, while the class gives refits and runs; its line in `diagnosis.routing.begin`.
"""
