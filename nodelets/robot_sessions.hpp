/// \file
/// Robots whose front ends start over.
#pragma once

#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <utility>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Names a robot's sessions for the core, to which segment IDs and stamps of one name must be consistent: the first
/// session has the robot's own name, later ones `name#2`, `name#3`. So what a robot saw before its front end was
/// restarted stays in the map, and the two trajectories find together by a loop closure like those of two robots.
class RobotSessions {
 public:
  enum class Change {
    kNone,
    kNewRobot,
    kRestarted,  ///< another session, at a later stamp
    kRewound,    ///< another session, at an earlier stamp: time jumped back, as when a bag is played again
    kEnded       ///< a session that was ended: its message is to be left out
  };
  struct Session {
    std::string name;
    Change change = Change::kNone;
  };

  /// The session that a message belongs to.
  Session Find(const std::string& robot, std::uint64_t session, StampNs stamp_ns) {
    if (ended_.count({robot, session}) > 0) return {robot, Change::kEnded};
    const auto [it, is_new] = states_.try_emplace(robot, State{session, 1, stamp_ns});
    State& state = it->second;
    if (is_new) return {robot, Change::kNewRobot};
    Change change = Change::kNone;
    if (session != state.session) {
      change = stamp_ns < state.stamp_ns ? Change::kRewound : Change::kRestarted;
      state.session = session;
      ++state.number;
    }
    state.stamp_ns = stamp_ns;
    return {state.number == 1 ? robot : robot + "#" + std::to_string(state.number), change};
  }

  /// Forgets all robots; the next message of each is that of a new robot.
  void Clear() { states_.clear(); }

  /// The present session of a robot is over: what still comes of it is left out.
  void End(const std::string& robot) {
    const auto state = states_.find(robot);
    if (state == states_.end()) return;
    ended_.insert({robot, state->second.session});
    states_.erase(state);
  }

  /// Ends those of all robots.
  void EndAll() {
    while (!states_.empty()) End(std::string(states_.begin()->first));
  }

 private:
  struct State {
    std::uint64_t session;
    int number;
    StampNs stamp_ns;
  };
  std::map<std::string, State> states_;
  std::set<std::pair<std::string, std::uint64_t>> ended_;
};

}  // namespace incremental_segmatch
