"""roc-validator on a finished campaign: `python -m tests.crate CAMPAIGN`."""
