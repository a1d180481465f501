"""Which effects are in the model: forward selection by the simulation error. That is the measured outputs minus those
of a free run: simulated from the initial state alone.

A *structure* is a set of effects (also called laws) in addition to mass, damping and stiffness M, D, K. An effect has
a place: one coordinate, two coordinates, an input or an output. Its *shape* is a first guess of the parameters that
enter it nonlinearly, such as a threshold; every effect has a grid of them. A *refit* of a structure estimates M, D, K,
initial states and all parameters of all effects together, shapes included. The search begins without effects. Every
round:

    Screen    the score test of every effect, at every place, in every shape, on the residual of the present structure
    Propose   the few effects with the highest scores, each at its best places, and what resembles the best one,
              whatever its score
    Refit     each of these candidates from several starts (`diagnosis.starts`); of each the best refit counts
    Order     by BIC, all under one noise model: that with which a candidate reached the best BIC
    Accept    the first candidate that passes the rule of `diagnosis.acceptance`: its amplitude is significant; no
              parameter is at a bound; with its values it does not reduce to another law; it removes at least a tenth of
              the residual in excess of the noise; and it gains on held-out data, with 99 % certainty
    Compare   candidates whose BIC differs from that of the accepted one by less than 6 (if one resembles the other, by
              less than 10) cannot be told from it: they are its equivalence class
    Prune     a law accepted before that the new one contains becomes part of it; one law takes the place of two that
              resemble each other, at one place, if it explains as much; laws that have become needless are dropped
    Swap      every law accepted before is compared again, in the model with the new one, with its class, with simpler
              laws that it contains, with what scored higher, with what resembles it, and with what was refitted in its
              round and explained less, or had no sure gain: the best one that holds there replaces it. A law whose
              amplitude is no longer significant gives way to one as good that is, and one whose further parameters
              explain nothing any more to the simpler law. Laws before one that was replaced are compared beside it
              once more. Then the next round

If no candidate passes, the round goes on to further *moves*, in this order, until one succeeds:

    1   a second score test, in which the effects that have just failed take no part
    2   a hidden mode (a coordinate without sensor) at every line in the spectrum of the residual (`starts`)
    3   the best candidate that failed only for its gain on held-out data is kept for one more round; both stay if
        another one passes in that round, otherwise neither

The search ends when the score test shows nothing, when no move succeeds, or with `max_effects` effects. If the score
test still shows something, the search goes back to a round and takes the likeliest candidate there that holds and
resembles none of the accepted laws (at most twice, where such a candidate was likeliest): the law that was taken may
have stood for two, with values that no later round could leave. Of both models the likelier one (BIC) is kept, if it is
no farther from held-out data. Then laws are swapped once more, in the final model, and a gap is called backlash or end
stop by how often it is left there.

state         the search state: structure, refit, what was accepted, what was refused and why
forward       the rounds
proposals     the candidates of a round and of moves 1 and 2, refitted from their starts
acceptance    the clauses that judge a refit in this search, for the rule of `diagnosis.acceptance`
confusable    which laws resemble one another, and which contain another one
provisional   move 3
backward      pruning
swap          accepted laws compared once more beside later ones; the last refits of all
parts         the search on a part of a long record, followed by a refit on all of it; candidates from the force
              equation (`diagnosis.equation_error`) where free runs lose phase with the record; where nothing holds a
              body, a search without an output offset, then one with it if more than noise is left
restart       the accepted model refitted once more under white noise; the refit counts if its residual is smaller

To add an effect: a class in the file of its family in `mechanics.effects`, which declares what it `contains` and
`resembles`; a row in `mechanics.effects.CATALOGUE`; its title in `diagnosis.words.titles.NAMES`.
To add a start: a module in `diagnosis.starts` with a function that gives candidates refitted from there, as in
`starts.other_models`; a line in `search.proposals.refitted`.
To add a move: a module in this folder with a function that gives refitted candidates; its name in
`diagnosis.findings.Move`; a line in `search.forward._round` (in `search.backward.prune` if it changes accepted laws); a
line in this docstring.
To add a likelihood (another residual than that of free runs): a folder beside `diagnosis.equation_error` with a class
derived from `diagnosis.selection.AbstractSelection`, whose rounds and acceptance take the place of those above; the new
class gives refits and simulations. And a line in `diagnosis.routing.begin`, which decides by what residual a record is
judged.
"""
