"""The balance of forces of a simulator along the measured motion, where its own run leaves the record at once.

An arm that its controller holds upright falls as soon as its torques are played back without the controller, whatever
the simulator is worth. Its equation of motion holds along the measured motion all the same.

equation     d(M(q) q̇)/dt less all that makes it, by the simulator's numbers and the laws it lacks
search       which laws are in that equation, judged by runs of the simulator over windows
conclusions  which numbers have to be other, and what is said of it
"""

from .conclusions import balance_diagnosis
from .equation import Balanced
from .search import search_balance

__all__ = ["Balanced", "balance_diagnosis", "search_balance"]
