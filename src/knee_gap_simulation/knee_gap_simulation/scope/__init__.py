"""The simulated arthroscope: lens, notch, image sensor, hand motion, tracker."""
