// Filters the matches of a synthetic pair: what a program of one's own looks like.

#include <mgca/filter.hpp>

#include <iostream>

/// filter_matches [MODEL [FIRST_LOOK]]
int main(int argc, char** argv) {
    // Two networks are the default: a quick one, and a deeper one where that does not settle the pair. Without files those
    // within the library, where it was built with them; one file alone is possible.
    const mgca::Model model = argc > 1 ? mgca::Model::from_file(argv[1]) : mgca::embedded_model();
    const mgca::Filter filter(argc > 2 ? model.with_first_look(mgca::Model::from_file(argv[2])) : model);

    // In a program of one's own these come from a detector and a matcher.
    std::vector<cv::Point2f> points1, points2;
    cv::RNG random(1);
    for (int i = 0; i < 200; ++i) {
        const float x = random.uniform(0.0F, 640.0F), y = random.uniform(0.0F, 480.0F);
        const float parallax = 800.0F / random.uniform(4.0F, 11.0F);  // the camera moves to the right
        points1.emplace_back(x, y);
        points2.emplace_back(i < 120 ? x - parallax : random.uniform(0.0F, 640.0F),
                             i < 120 ? y : random.uniform(0.0F, 480.0F));
    }

    const cv::Matx33d K(800, 0, 319.5, 0, 800, 239.5, 0, 0, 1);
    const mgca::Result result = filter(points1, points2, mgca::Matches::same_rows(points1.size()), K);

    std::cout << mgca::to_string(result.status) << ": " << result.num_inliers << " of " << result.mask.size()
              << " matches kept\n";
    if (result.t) {
        std::cout << "direction " << result.t->t() << ", confidence " << result.confidence.value_or(0.0) << "\n";
    }
    return result.ok() ? 0 : 1;
}
