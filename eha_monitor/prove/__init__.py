"""The proof: effects concealed in recordings, a sealed key, a blind diagnosis, and its marks."""
