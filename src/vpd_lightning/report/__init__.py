"""What several runs say together: tables, plots and strips of rollouts over the evaluations of many trainings."""
