"""Linear head models of others beside GNM: one form in memory for all, readers of their files, evaluation in torch.

`registry.read` reads a file of any known format; `model.LinearModel` evaluates it.
"""
