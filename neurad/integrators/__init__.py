"""Estimators of radiance. All of them share one vertex: emission, emitter sampling, BSDF sampling and MIS."""
