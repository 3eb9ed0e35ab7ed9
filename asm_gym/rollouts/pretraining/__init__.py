"""Motor babbling, the memory that learns from its healthy episodes, and the evaluation of that memory."""
