"""The figures of a star sensor in the terms of ECSS-E-ST-60-20C, from electrons to attitude."""
