// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Print every message's stamp and the channels that are not OK: subscribes to ~/integrity, whose label names its values.
//
//   ros2 run YOUR_PACKAGE integrity --ros-args -r integrity:=/fdi_node/integrity

#include <map>
#include <memory>
#include <sstream>
#include <string>

#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"

using std_msgs::msg::Float64MultiArray;

std::map<std::string, double> read(const Float64MultiArray & message)
{
  std::map<std::string, double> values;
  std::stringstream labels(message.layout.dim.at(0).label);
  std::string label;
  for (size_t k = 0; std::getline(labels, label, ',') && k < message.data.size(); ++k) {
    values[label] = message.data[k];
  }
  return values;
}

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  const auto node = std::make_shared<rclcpp::Node>("integrity_example");
  const auto subscription = node->create_subscription<Float64MultiArray>(
    "integrity", 10, [&node](const Float64MultiArray & message) {
      const auto values = read(message);
      const double stamp = values.at("stamp [s]") + 1e-9 * values.at("stamp [ns]");
      for (const auto & [label, value] : values) {
        // 0 is OK; the other states stand in docs/live.md.
        if (label.rfind("state ", 0) == 0 && value != 0.0) {
          RCLCPP_WARN(
            node->get_logger(), "%.3f s: %s is %d", stamp, label.substr(6).c_str(),
            static_cast<int>(value));
        }
      }
    });
  rclcpp::spin(node);
  rclcpp::shutdown();
  return 0;
}
