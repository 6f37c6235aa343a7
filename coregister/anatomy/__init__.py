"""Eyes, teeth and tongue of a model from data of their own [GNM, Internal Anatomy]."""
