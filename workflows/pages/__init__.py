"""Static HTML pages of subjects, stabilizations, models, evaluations and coregistrations."""
