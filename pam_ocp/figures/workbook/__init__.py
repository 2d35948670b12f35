"""Spreadsheets: results as workbooks, a fitted law as live formulas."""
