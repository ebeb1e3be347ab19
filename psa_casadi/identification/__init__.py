"""Parameters from records: prediction-error fits, and what the records determine."""
