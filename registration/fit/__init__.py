"""The fitting problem of one capture: recipes, initial guess, variables, optimizer, appearance, view weights."""
