// Times the filter for benchmarks/cpp_speed.py: pairs from a file, one answer for each line on standard input.
//
//     time_pairs MODEL FIRST_LOOK PAIRS
//
// PAIRS holds, for each pair: the numbers of keypoints 1, keypoints 2 and rows; fx, fy, cx, cy of each camera, or zeros without
// intrinsics; x, y, size and angle of each keypoint; first and second candidate of each row: index in image 2 and distance, the index -1
// where there is no second. Row i is of keypoint `query`, its first number. Input is the number of a pair and 1 for
// effort=full, else 0; output milliseconds of the processor, status and number of kept matches. What an OpenCV program holds is what is
// timed: keypoints and matches are converted within the time.

#include <mgca/filter.hpp>

#include <opencv2/core.hpp>

#include <ctime>
#include <exception>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

struct Pair {
    std::vector<cv::KeyPoint> keypoints1, keypoints2;
    std::vector<std::vector<cv::DMatch>> rows;
    mgca::Camera camera1, camera2;
};

std::vector<cv::KeyPoint> read_keypoints(std::istream& in, std::size_t count) {
    std::vector<cv::KeyPoint> keypoints(count);
    for (cv::KeyPoint& keypoint : keypoints) {
        in >> keypoint.pt.x >> keypoint.pt.y >> keypoint.size >> keypoint.angle;
    }
    return keypoints;
}

mgca::Camera read_camera(std::istream& in) {
    double fx = 0.0, fy = 0.0, cx = 0.0, cy = 0.0;
    in >> fx >> fy >> cx >> cy;
    return fx > 0.0 ? mgca::Camera(cv::Matx33d(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)) : mgca::Camera();
}

std::vector<Pair> read_pairs(const char* file) {
    std::ifstream in(file);
    std::vector<Pair> pairs;
    std::size_t count1 = 0, count2 = 0, count = 0;
    while (in >> count1 >> count2 >> count) {
        Pair pair;
        pair.camera1 = read_camera(in);
        pair.camera2 = read_camera(in);
        pair.keypoints1 = read_keypoints(in, count1);
        pair.keypoints2 = read_keypoints(in, count2);
        for (std::size_t i = 0; i < count; ++i) {
            int query = 0, first = 0, second = 0;
            float distance = 0.0F, second_distance = 0.0F;
            in >> query >> first >> distance >> second >> second_distance;
            pair.rows.push_back({cv::DMatch(query, first, distance)});
            if (second >= 0) {
                pair.rows.back().emplace_back(query, second, second_distance);
            }
        }
        if (!in) {
            throw std::runtime_error(std::string(file) + ": pair " + std::to_string(pairs.size()) + " cannot be read");
        }
        pairs.push_back(std::move(pair));
    }
    return pairs;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 4) {
        std::cerr << "usage: time_pairs MODEL FIRST_LOOK PAIRS\n";
        return 2;
    }
    try {
        cv::setNumThreads(1);
        const mgca::Model model = mgca::Model::from_file(argv[1]).with_first_look(mgca::Model::from_file(argv[2]));
        mgca::Options full;
        full.effort = mgca::Effort::full;
        const mgca::Filter filters[] = {mgca::Filter(model), mgca::Filter(model, full)};
        const std::vector<Pair> pairs = read_pairs(argv[3]);
        std::cout << mgca::Model::runtime() << ", OpenCV " << CV_VERSION << std::endl;
        std::size_t index = 0, effort = 0;
        while (std::cin >> index >> effort) {
            const Pair& pair = pairs.at(index);
            const std::clock_t started = std::clock();
            const mgca::Result result =
                filters[effort == 1 ? 1 : 0](pair.keypoints1, pair.keypoints2, pair.rows, pair.camera1, pair.camera2);
            const double elapsed_ms = 1e3 * static_cast<double>(std::clock() - started) / CLOCKS_PER_SEC;
            std::cout << elapsed_ms << " " << mgca::to_string(result.status) << " " << result.num_inliers
                      << std::endl;
        }
    } catch (const std::exception& error) {
        std::cerr << "time_pairs: " << error.what() << "\n";
        return 1;
    }
    return 0;
}
