"""Inspection of captures: finds problems that would spoil a scene, and suggests how to repair them."""

from splatax.inspection.examination import Examination as Examination
from splatax.inspection.examination import examine as examine
from splatax.inspection.pace import forecasted as forecasted
from splatax.inspection.problems import Problem as Problem
from splatax.inspection.problems import problems_of as problems_of
