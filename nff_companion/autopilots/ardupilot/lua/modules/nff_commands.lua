-- What the companion says: who is obeyed, what of it is taken, and what is refused and why.
--
-- One companion is obeyed at a time, told apart by the `instance` that each draws at its start: the first that is
-- heard, until it says goodbye or was silent for OWNER_LOST_MS. What another one says meanwhile is refused.

local P = require("nff_protocol")
local T = require("nff_times")
local airframe = require("nff_airframe")
local mixer = require("nff_mixer")

local C = {}

local COMPONENT_FIRST, COMPONENT_LAST = 191, 194
local TEXT_WARNING = 4
local motors_library = motors -- the firmware's binding of this name
local motors = airframe.motors
local own_system = math.floor(param:get("MAV_SYSID") or param:get("SYSID_THISMAV") or 1)

C.held = 0 -- mask of the motors declared failed
C.matrix = nil -- {factors, failed, released, expires_ms}
C.override_until_ms = 0
C.channels = {} -- servo channel of each motor, from 0
C.owner = 0 -- instance that is obeyed; 0: nobody
C.companion = nil -- {channel, system, component, heard_ms} of the owner
C.listener = nil -- the same of the last one that was not obeyed: it must see why
C.accepted = 0
C.refused = {}
C.answer_now = false -- what is in force is to be said in this run
for _, name in ipairs(P.REFUSALS) do
  C.refused[name] = 0
end

-- Sequence and time of the last command taken of each kind.
local last = {
  [P.DECLARATION] = { sequence = 0, ms = 0 },
  [P.MATRIX] = { sequence = 0, ms = 0 },
  [P.OVERRIDE] = { sequence = 0, ms = 0 },
}
last[P.RELEASE] = last[P.MATRIX] -- they undo each other
local left, left_ms = 0, 0 -- instance that said goodbye last

local function forget_sequences(now)
  for _, of_kind in pairs(last) do
    of_kind.sequence, of_kind.ms = 0, now - T.LINK_LOST_MS
  end
end

-- Sequence of the last command of a kind that was taken.
function C.sequence(kind)
  return last[kind].sequence
end

-- Whether the owner was heard lately.
function C.linked(now)
  return C.owner ~= 0 and now - C.companion.heard_ms < T.LINK_LOST_MS
end

-- Nothing streamed stays in force.
function C.drop()
  C.matrix, C.override_until_ms = nil, 0
end

function C.set_held(mask)
  C.held = mask
  C.failed_parameter:set(mask)
end

function C.is_held(motor)
  return (C.held >> (motor - 1)) & 1 == 1
end

-- Holds the channel of a motor at its lowest pulse for a moment.
function C.stop(motor)
  local channel = C.channels[motor]
  if channel then
    SRV_Channels:set_output_pwm_chan_timeout(channel, airframe.pwm_min, T.STOP_MS)
  end
end

-- Overrides win over the firmware's own stops: it is on us to honour them.
function C.stopped_by_pilot()
  return SRV_Channels:get_emergency_stop() or not motors_library:get_interlock()
end

local function refuse(reason)
  C.refused[reason] = (C.refused[reason] + 1) % 65536
end

local function count_of(mask)
  local count = 0
  for motor = 1, motors do
    count = count + ((mask >> (motor - 1)) & 1)
  end
  return count
end

-- Reason not to take a command that answers an old sample or was overtaken. What was overtaken by LINK_LOST_MS is
-- stale besides, so that sequences, which wrap, are compared over a short time alone.
local function late(fields, now)
  local age = now - fields.sample_ms
  if age < -T.EARLY_MS or age > T.STALE_MS then
    return "stale"
  end
  local before = last[fields.kind]
  local ahead = (fields.sequence - before.sequence) % 65536
  if now - before.ms < T.LINK_LOST_MS and (ahead == 0 or ahead >= 32768) then
    return "replay"
  end
  return nil
end

local function took(fields, now)
  local before = last[fields.kind]
  before.sequence, before.ms = fields.sequence, now
  return nil
end

-- Whether no vehicle flies with these motors failed.
local function beyond(mask)
  return mask >= 1 << motors or count_of(mask) > motors // 2
end

-- Reason not to take factors: wrong size, or a motor driven that is declared failed.
local function unfit(fields)
  if fields.motors ~= motors then
    return "dimension"
  end
  if beyond(fields.failed) then
    return "range"
  end
  for motor = 1, motors do
    local throttle, roll, pitch, yaw = string.unpack("<i2i2i2i2", fields.factors, 8 * motor - 7)
    local failed = (fields.failed >> (motor - 1)) & 1 == 1
    if throttle < 0 or (failed and (throttle ~= 0 or roll ~= 0 or pitch ~= 0 or yaw ~= 0)) then
      return "range"
    end
  end
  return nil
end

local handlers = {}

handlers[P.HEARTBEAT] = function()
  return nil
end

handlers[P.TABLE] = function(fields)
  if arming:is_armed() then
    return "armed"
  end
  local reason = unfit(fields)
  if reason then
    return reason
  end
  local check = mixer.store(fields.failed, fields.factors)
  if not check then
    return "range"
  end
  local answer = P.pack(P.STORED, { sequence = fields.sequence, failed = fields.failed, check = check })
  local to = C.companion
  mavlink:send_chan(to.channel, P.TUNNEL, P.tunnel(to.system, to.component, answer))
  return nil
end

handlers[P.DECLARATION] = function(fields, now)
  local reason = late(fields, now)
  if reason then
    return reason
  end
  if not arming:is_armed() then
    return "disarmed"
  end
  if beyond(fields.failed) then
    return "range"
  end
  C.answer_now = true
  if fields.failed ~= C.held then
    C.set_held(fields.failed)
    if C.matrix and C.matrix.failed ~= C.held then
      C.matrix = nil
    end
    gcs:send_text(TEXT_WARNING, string.format("NFF: failed mask %d at %d", C.held, now))
  end
  return took(fields, now)
end

handlers[P.MATRIX] = function(fields, now)
  if not mixer.dynamic then
    return "unsupported"
  end
  local reason = late(fields, now) or unfit(fields)
  if reason then
    return reason
  end
  if not arming:is_armed() then
    return "disarmed"
  end
  if fields.failed ~= C.held or fields.timeout_ms == 0 or fields.timeout_ms > T.MATRIX_TIMEOUT_MAX_MS then
    return "range"
  end
  C.matrix = {
    factors = fields.factors,
    failed = fields.failed,
    released = fields.flags & P.YAW_RELEASED ~= 0,
    expires_ms = now + fields.timeout_ms,
  }
  return took(fields, now)
end

handlers[P.RELEASE] = function(fields, now)
  local reason = late(fields, now)
  if reason then
    return reason
  end
  C.matrix = nil
  if fields.flags & P.LEAVING ~= 0 then
    left, left_ms = C.owner, now
    C.owner = 0
    C.answer_now = true
  end
  return took(fields, now)
end

handlers[P.OVERRIDE] = function(fields, now)
  local reason = late(fields, now)
  if reason then
    return reason
  end
  if not arming:is_armed() or C.stopped_by_pilot() then
    return "disarmed"
  end
  if fields.motors ~= motors then
    return "dimension"
  end
  if fields.timeout_ms == 0 or fields.timeout_ms > T.OVERRIDE_TIMEOUT_MS then
    return "range"
  end
  for motor = 1, motors do
    local pwm = string.unpack("<I2", fields.pwm, 2 * motor - 1)
    if pwm ~= 0 and (pwm < airframe.pwm_min or pwm > airframe.pwm_max) then
      return "range"
    end
  end
  for motor = 1, motors do
    local pwm = string.unpack("<I2", fields.pwm, 2 * motor - 1)
    if pwm ~= 0 and C.channels[motor] and not C.is_held(motor) then
      SRV_Channels:set_output_pwm_chan_timeout(C.channels[motor], pwm, fields.timeout_ms)
    end
  end
  C.override_until_ms = now + fields.timeout_ms
  return took(fields, now)
end

-- Notes where a message came from.
local function noted(who, now, channel, system, component)
  who = who or {}
  who.channel, who.system, who.component, who.heard_ms = channel, system, component, now
  return who
end

-- Whether this instance is obeyed; the first after a silence, or after a goodbye, is from here on.
local function obeyed(instance, now)
  if C.owner ~= 0 and now - C.companion.heard_ms < T.OWNER_LOST_MS then
    return instance == C.owner
  end
  -- What was on its way when its sender said goodbye does not bring it back.
  if instance == 0 or (instance == left and now - left_ms < T.OWNER_LOST_MS) then
    return false
  end
  if instance ~= C.owner then
    C.matrix = nil
  end
  C.owner = instance
  forget_sequences(now)
  return true
end

-- One message of the queue; whether there was one.
function C.receive(now)
  local message, channel = mavlink:receive_chan()
  if not message then
    return false
  end
  local fields, system, component = P.open(message, own_system)
  if not system or system ~= own_system or component < COMPONENT_FIRST or component > COMPONENT_LAST then
    return true
  end
  local reason = nil
  if not fields or not handlers[fields.kind] then
    reason = "format" -- a companion of another release too: it must hear of which we are
  elseif not obeyed(fields.instance, now) then
    reason = "occupied"
  end
  if reason then
    C.listener = noted(C.listener, now, channel, system, component)
  else
    C.companion = noted(C.companion, now, channel, system, component)
    reason = handlers[fields.kind](fields, now)
  end
  if reason then
    refuse(reason)
  else
    C.accepted = (C.accepted + 1) % 65536
  end
  return true
end

return C
