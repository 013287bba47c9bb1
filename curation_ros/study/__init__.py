"""Studies: which selection of demonstrations gives the better policy; the plan comes first."""
