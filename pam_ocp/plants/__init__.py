"""Plants: muscles and a load, as named variables and CasADi expressions."""
