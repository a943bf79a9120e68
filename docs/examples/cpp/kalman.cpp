// A Kalman filter of a car on a straight road, in a world that is simulated from a seed.
//
//     kalman SEED [Q]
//
// writes estimates.csv into the working folder: step, time (s), the true position (m) and velocity (m/s), their estimates
// and the covariance. Q is the noise of the acceleration that the filter believes in (m^2/s^3), by default the true one.

#include <cmath>
#include <fstream>
#include <iostream>
#include <random>
#include <string>

// The world. The filter has noises of its own, so that one can be changed without the other.
constexpr int STEPS = 100, FIX_EVERY = 10;  // the position is measured once a second
constexpr double DT = 0.1;                  // s
constexpr double TRUE_Q = 1.0;              // m^2/s^3, power spectral density of the acceleration, white noise
constexpr double TRUE_SIGMA = 0.3;          // m, of a measured position

struct Filter {
    double Q = 1.0;                       // m^2/s^3
    double sigma = 0.3;                   // m
    double p = 0, v = 0;                  // m, m/s
    double Ppp = 1.0, Ppv = 0, Pvv = 1.0; // their covariance

    void predict() {
        p += DT * v;
        Ppp += DT * (2 * Ppv + DT * Pvv) + Q * DT * DT * DT / 3;
        Ppv += DT * Pvv + Q * DT * DT / 2;
        Pvv += Q * DT;
    }

    void update(double measured) {
        const double S = Ppp + sigma * sigma, Kp = Ppp / S, Kv = Ppv / S;
        const double innovation = measured - p;
        p += Kp * innovation;
        v += Kv * innovation;
        Pvv -= Kv * Ppv;
        Ppv -= Kp * Ppv;
        Ppp -= Kp * Ppp;
    }
};

int main(int argc, char** argv) {
    if (argc < 2) {
        std::cerr << "usage: kalman SEED [Q]\n";
        return 2;
    }
    std::mt19937 generator(std::stoi(argv[1]));
    std::normal_distribution<double> normal;
    Filter filter;
    if (argc > 2) filter.Q = std::stod(argv[2]);

    std::ofstream out("estimates.csv");
    out.precision(9);
    out << "step,t,true_p,true_v,p,v,P_p_p,P_p_v,P_v_v\n";
    double p = normal(generator), v = normal(generator);  // with the covariance that the filter starts from
    for (int step = 1; step <= STEPS; ++step) {
        const double kick = std::sqrt(TRUE_Q * DT) * normal(generator);  // the acceleration, integrated over the step
        p += DT * (v + kick / 2) + std::sqrt(TRUE_Q * DT * DT * DT / 12) * normal(generator);
        v += kick;
        filter.predict();
        if (step % FIX_EVERY == 0) filter.update(p + TRUE_SIGMA * normal(generator));
        out << step << ',' << step * DT << ',' << p << ',' << v << ',' << filter.p << ',' << filter.v << ','
            << filter.Ppp << ',' << filter.Ppv << ',' << filter.Pvv << '\n';
    }
    if (!out.flush()) {
        std::cerr << "estimates.csv cannot be written\n";
        return 1;
    }
}
