"""Controllers, estimators and motions as blocks: the one form in which they run elsewhere."""
