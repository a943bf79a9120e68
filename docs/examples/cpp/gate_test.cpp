#include <gtest/gtest.h>

#include <cstdlib>

TEST(Kalman, StatesTheCovarianceOfItsErrors) {
    EXPECT_EQ(0, std::system("consistency monte-carlo --state p,v --false-alarm 0.001 --seed 0"
                             " --fail-on inconsistent --out from_gtest --overwrite -- ./kalman {seed}"));
}
