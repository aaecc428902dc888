"""Extensions of an incomplete model: candidates and their selection."""
