"""Which effects are in the model: forward selection by the simulation error, measured outputs minus simulated ones.

A *structure* is a set of effects. Each has a place (a coordinate or two, an input, an output) and a shape (the values
of the parameters in which it is not linear, such as a threshold). A *refit* of it estimates M, D, K, initial states and
the parameters of all effects together. The search begins with the structure without effects. Every round:

    Screen    the score test of every effect, at every place, in every shape, on the residual of the present structure
    Propose   the few effects that score highest, each at its likeliest places, and the look-alikes of the best
    Refit     each from every start that applies (`diagnosis.starts`); the best end of each counts
    Order     by BIC, with the noise model of the best refit for all; one that contains a simpler law must explain more
              than its further parameters would by chance
    Accept    the first that passes the one rule (`diagnosis.acceptance`): it is significant, at no bound, no other law
              at these values, removes a tenth of what the present structure leaves above the noise, and its gain on
              held-out data is positive (99 %)
    Compare   refits within ΔBIC 6 of it (10 for look-alikes) form an equivalence class with it
    Prune     a law that it contains is united with it, laws that it made needless are dropped, or else simpler ones are
              put in the place of those that hardly differ from them; then the next round

Where no candidate passes, the round makes other *moves*, in this order:

    1   the effects of the next highest score, without those that failed in this round
    2   hidden modes, at lines in the spectrum of the residual
    3   the same candidates, refitted under white noise
    4   the best candidate whose gain alone is not sure: kept provisionally, until a second one gains together with it

The search ends where the score test shows nothing, where no move passes, or with `max_effects` effects. Then the
members of every equivalence class are compared once more in the whole model.

state         the search state: structure, refit, what was accepted, what was refused and why
forward       the rounds
proposals     which candidates a round refits, and from which starts
acceptance    the evidence for one refit, and its gain on held-out data
confusable    look-alikes, and laws that contain another and add nothing
provisional   laws that gain only together with a second one
backward      unite, drop and simplify after an acceptance
final_swap    members of an equivalence class compared once more in the whole model
parts         the search on a part of a long record, and what it found refitted on the whole; whether the free run is
              out of phase with the record: candidates then come from the force equation
restart       the accepted model refitted under white noise, or from the modes of the record; kept where it leaves less

To add an effect: a class in the file of its family in `mechanics.effects`, which says itself what it `contains` and
`resembles`, its row in `mechanics.effects.CATALOGUE`, and its name for readers in `diagnosis.words.titles`.
To add a start, which may bring laws of its own: a module in `diagnosis.starts` with a function that gives refitted
candidates, as in `starts.other_models`, and its line in `search.proposals.refitted`.
To add a move: a module here with such a function, its name in `diagnosis.findings.Move`, and its line in
`search.forward._round`, or in `search.backward.prune` where it changes what was accepted already.
To add a likelihood: a folder beside `diagnosis.equation_error` with a class derived from
`diagnosis.selection.AbstractSelection`, which has the rounds and the acceptance and asks for refits and runs, and its
line in `diagnosis.routing.begin`.
"""
