"""The data doctor: whether a capture will make a good scene, and what would make it better."""

from splatax.inspection.examination import Examination as Examination
from splatax.inspection.examination import examine as examine
from splatax.inspection.pace import seconds_to_train as seconds_to_train
from splatax.inspection.problems import Problem as Problem
from splatax.inspection.problems import problems_of as problems_of
