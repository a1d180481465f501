"""The user's own simulator on trial: y = f(u, w, θ), with w a force at every coordinate and θ its numbers.

    runs               the simulator as it is called, and the linear plant that stands for it about a run
    search             numbers first, then laws, then both in the simulator itself
    beginning          the linear plant about a run near the records, and the numbers there
    growing_parts      numbers by its own runs, over parts of the records that grow
    settling           laws and numbers where they stand still in the simulator
    contenders         the law that explains most there, and laws that a newer one makes needless
    necessary_numbers  the fewest numbers that have to be other, and which of them stand for one another
    conclusions        what is said of it, and what one run gains over another
    force_balance      its balance of forces along the measured motion, where no run follows the record

A law is looked for in a linear plant P that answers as the simulator does to small forces. Its input is not the
record's: it is the force under which P moves as the simulator does, less the force that the simulator lacks. So its run
is the record less P times the lacking force, and whatever P is, a law that makes this force along the measured motion
explains the whole residual. A law that is found is then run in the simulator itself, where its force follows from the
simulator's own motion.
"""

from .search import diagnose_simulator

__all__ = ["diagnose_simulator"]
