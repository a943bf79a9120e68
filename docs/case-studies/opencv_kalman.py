"""Have the errors of OpenCV's Kalman filter the covariance that it states?"""

import cv2
import numpy as np
from linear import AXES, STEADY, H, textbook
from study import Case


def judged(data):
    truth, z, errors, covariances = *data, [], []
    for states, run in zip(truth, z, strict=True):
        kf = cv2.KalmanFilter(2, 1, 0, cv2.CV_64F)
        kf.transitionMatrix, kf.measurementMatrix = STEADY.F[0], H
        kf.processNoiseCov, kf.measurementNoiseCov = STEADY.Q[0], np.array([[STEADY.R]])
        kf.statePost, kf.errorCovPost = np.zeros((2, 1)), np.eye(2)
        for x, each in zip(states, run, strict=True):
            kf.predict()
            errors.append(x - kf.correct(np.array([[each]])).ravel())
            covariances.append(kf.errorCovPost.copy())
    return {"KalmanFilter": (np.reshape(errors, truth.shape), np.reshape(covariances, (*truth.shape, 2)))}


def second():
    return STEADY.exact("KalmanFilter", lambda data: judged(data)["KalmanFilter"])


CASE = Case("opencv-python-headless", AXES, 117, STEADY.simulate, judged, textbook, second)

if __name__ == "__main__":
    CASE.main()
