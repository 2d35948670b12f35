# Names of pam_ocp.studies, loaded at their first use.
from .file_kinds import load as load
from .from_table import Quick as Quick
from .from_table import quick as quick
from .loads import LoadStudy as LoadStudy
from .loads import load_study as load_study
from .study import run_study as run_study
from .study_result import StudyResult as StudyResult
from .study_result import StudyStep as StudyStep
