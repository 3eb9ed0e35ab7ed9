"""Motor babbling (random exploration), learning from its healthy episodes, and the card of the memory it gives."""
