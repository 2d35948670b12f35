"""The planner as one method: a prototype beside the chain of stages in ``pam_ocp.planning``.

One continuation, one mesh sequence, one search (``../method_study.py`` compares both).
"""
