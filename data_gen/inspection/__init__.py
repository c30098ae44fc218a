"""Judge and look at data sets: validate, inspect, split."""
