-- The autopilot's side of nff-companion: takes motor declarations, allocation matrices and motor outputs through TUNNEL.
--
-- What is in force, the first that holds: overrides of single channels (they expire in the firmware by themselves);
-- the streamed matrix while it is fresh; the stored table of the declared motors; the stock factors.
-- A declaration is held when the link is lost; everything else is given up. Nothing is driven when disarmed.

local P = require("nff_protocol")
local airframe = require("nff_airframe") -- motors, tables, pwm range: written by `nff ardupilot install`

local VERSION = 1
local COMPONENT_FIRST, COMPONENT_LAST = 191, 194
local FRAME_CLASS_DYNAMIC = 17
local LINK_LOST_MS = 1000
local STALE_MS, EARLY_MS = 250, 50
local MATRIX_TIMEOUT_MAX_MS, OVERRIDE_TIMEOUT_MAX_MS = 2000, 100
local STOP_MS = 20 -- a stopped motor's channel is held this long, and renewed at each run
local APPLIED_MS = 50
local SOURCE_STOCK, SOURCE_DECLARATION, SOURCE_MATRIX, SOURCE_OVERRIDE = 0, 1, 2, 3
local TEXT_WARNING, TEXT_INFO = 4, 6
local PARAMETER_TABLE = 146 -- key of our parameters: one number a script, for all scripts of a vehicle

local motors_library = motors -- the firmware's binding of this name
local motors = airframe.motors
local own_system = math.floor(param:get("MAV_SYSID") or param:get("SYSID_THISMAV") or 1)
local dynamic = param:get("FRAME_CLASS") == FRAME_CLASS_DYNAMIC
local boot_ms = millis():toint()

local tables = {} -- failed mask to factors (m rows of throttle, roll, pitch, yaw as int16)
for mask, factors in pairs(airframe.tables) do
  tables[mask] = factors
end
local channels = {} -- servo channel of each motor, from 0
local held = 0 -- mask of the motors declared failed
local matrix = nil -- {factors, failed, expires_ms}
local override_until_ms = 0
local last_packet_ms = -LINK_LOST_MS
local last_applied_ms = 0
local sequences = { declaration = 0, matrix = 0, override = 0, applied = 0 }
local accepted = 0
local refused = {}
local companion = nil -- {channel, system, component}
local in_force = nil -- factors last loaded
local errors = 0
local watchdog_count, watchdog_seen_ms = -1, -1000

-- Counters that the watchdog script and a ground station can read.
param:add_table(PARAMETER_TABLE, "NFF_", 3)
param:add_param(PARAMETER_TABLE, 1, "ALIVE", 0)
param:add_param(PARAMETER_TABLE, 2, "FAILED", 0)
param:add_param(PARAMETER_TABLE, 3, "WATCH", 0)
local alive = Parameter("NFF_ALIVE")
local failed_parameter = Parameter("NFF_FAILED")
local watchdog = Parameter("NFF_WATCH")
local ticks = 0
local last_run_ms = boot_ms
failed_parameter:set(0)

for _, name in ipairs(P.REFUSALS) do
  refused[name] = 0
end

local function bit_of(mask, motor)
  return (mask >> (motor - 1)) & 1 == 1
end

local function count_of(mask)
  local count = 0
  for motor = 1, motors do
    count = count + ((mask >> (motor - 1)) & 1)
  end
  return count
end

-- Stock factors without the motors of a mask: what is left when no table was ever computed for it.
local function without(mask)
  local rows = {}
  for motor = 1, motors do
    rows[motor] = bit_of(mask, motor) and ("\0"):rep(8) or tables[0]:sub(8 * motor - 7, 8 * motor)
  end
  return table.concat(rows)
end

local function load(factors)
  if factors == in_force then
    return
  end
  local loaded = motor_factor_table()
  for motor = 1, motors do
    local throttle, roll, pitch, yaw = string.unpack("<i2i2i2i2", factors, 8 * motor - 7)
    loaded:throttle(motor - 1, throttle / P.FACTOR_SCALE)
    loaded:roll(motor - 1, roll / P.FACTOR_SCALE)
    loaded:pitch(motor - 1, pitch / P.FACTOR_SCALE)
    loaded:yaw(motor - 1, yaw / P.FACTOR_SCALE)
  end
  Motors_dynamic:load_factors(loaded)
  in_force = factors
end

-- Puts in force what the top of this file says; returns where it comes from.
local function apply(now)
  local source = SOURCE_STOCK
  local factors = tables[0]
  if held ~= 0 then
    source = SOURCE_DECLARATION
    factors = tables[held] or without(held)
  end
  if matrix then
    source = SOURCE_MATRIX
    factors = matrix.factors
  end
  if dynamic then
    load(factors)
  end
  if now < override_until_ms then
    source = SOURCE_OVERRIDE
  end
  return source
end

local function refuse(reason)
  refused[reason] = (refused[reason] + 1) % 65536
  return reason
end

-- Reason not to take a command that answers an old sample or was overtaken.
local function late(fields, now, holding, last)
  local age = now - fields.sample_ms
  if age < -EARLY_MS or age > STALE_MS then
    return "stale"
  end
  local ahead = (fields.sequence - last) % 65536
  if holding and (ahead == 0 or ahead >= 32768) then
    return "replay"
  end
  return nil
end

-- Reason not to take factors: wrong size, or a motor driven that is declared failed.
local function unfit(fields)
  if fields.motors ~= motors then
    return "dimension"
  end
  if fields.failed >= 1 << motors or count_of(fields.failed) > motors // 2 then
    return "range"
  end
  for motor = 1, motors do
    local row = fields.factors:sub(8 * motor - 7, 8 * motor)
    local throttle = string.unpack("<i2", row)
    if throttle < 0 or (bit_of(fields.failed, motor) and row ~= ("\0"):rep(8)) then
      return "range"
    end
  end
  return nil
end

-- Overrides win over the firmware's own stops: it is on us to honour them.
local function stopped_by_pilot()
  return SRV_Channels:get_emergency_stop() or not motors_library:get_interlock()
end

local handlers = {}

handlers[P.HEARTBEAT] = function()
  return nil
end

handlers[P.TABLE] = function(fields)
  local reason = unfit(fields)
  if reason then
    return reason
  end
  tables[fields.failed] = fields.factors
  local answer = P.pack(
    P.STORED, { sequence = fields.sequence, failed = fields.failed, check = P.check(fields.factors) }
  )
  mavlink:send_chan(companion.channel, P.TUNNEL, P.tunnel(companion.system, companion.component, answer))
  return nil
end

handlers[P.DECLARATION] = function(fields, now)
  local reason = late(fields, now, false, 0)
  if reason then
    return reason
  end
  if not arming:is_armed() then
    return "disarmed"
  end
  if fields.failed >= 1 << motors or count_of(fields.failed) > motors // 2 then
    return "range"
  end
  last_applied_ms = now - APPLIED_MS -- acknowledged in this run
  sequences.declaration = fields.sequence
  if fields.failed ~= held then
    held = fields.failed
    failed_parameter:set(held)
    if matrix and matrix.failed ~= held then
      matrix = nil
    end
    gcs:send_text(TEXT_WARNING, string.format("NFF: failed mask %d at %d", held, now))
  end
  return nil
end

handlers[P.MATRIX] = function(fields, now)
  if not dynamic then
    return "unsupported"
  end
  local reason = late(fields, now, matrix ~= nil, sequences.matrix) or unfit(fields)
  if reason then
    return reason
  end
  if not arming:is_armed() then
    return "disarmed"
  end
  if fields.failed ~= held or fields.timeout_ms == 0 or fields.timeout_ms > MATRIX_TIMEOUT_MAX_MS then
    return "range"
  end
  matrix = { factors = fields.factors, failed = fields.failed, expires_ms = now + fields.timeout_ms }
  sequences.matrix = fields.sequence
  return nil
end

handlers[P.RELEASE] = function(fields, now)
  local reason = late(fields, now, matrix ~= nil, sequences.matrix)
  if reason then
    return reason
  end
  matrix = nil
  sequences.matrix = fields.sequence
  return nil
end

handlers[P.OVERRIDE] = function(fields, now)
  local reason = late(fields, now, now < override_until_ms, sequences.override)
  if reason then
    return reason
  end
  if not arming:is_armed() or stopped_by_pilot() then
    return "disarmed"
  end
  if fields.motors ~= motors then
    return "dimension"
  end
  if fields.timeout_ms == 0 or fields.timeout_ms > OVERRIDE_TIMEOUT_MAX_MS then
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
    if pwm ~= 0 and channels[motor] and not bit_of(held, motor) then
      SRV_Channels:set_output_pwm_chan_timeout(channels[motor], pwm, fields.timeout_ms)
    end
  end
  override_until_ms = now + fields.timeout_ms
  sequences.override = fields.sequence
  return nil
end

-- One message of the queue; whether there was one.
local function receive(now)
  local message, channel = mavlink:receive_chan()
  if not message then
    return false
  end
  local fields, system, component = P.open(message, own_system)
  if not system or system ~= own_system or component < COMPONENT_FIRST or component > COMPONENT_LAST then
    return true
  end
  if not fields or not handlers[fields.kind] then
    refuse("format")
    return true
  end
  companion = { channel = channel, system = system, component = component }
  last_packet_ms = now
  local reason = handlers[fields.kind](fields, now)
  if reason then
    refuse(reason)
  else
    accepted = (accepted + 1) % 65536
  end
  return true
end

local function report(now, source)
  if not companion or now - last_applied_ms < APPLIED_MS then
    return
  end
  last_applied_ms = now
  sequences.applied = (sequences.applied + 1) % 65536
  local flags = (arming:is_armed() and 1 or 0)
    | (dynamic and 2 or 0)
    | (now - watchdog_seen_ms < 500 and 4 or 0)
    | (now - last_packet_ms < LINK_LOST_MS and 8 or 0)
  local count = 0
  for _ in pairs(tables) do
    count = count + 1
  end
  local fields = {
    sequence = sequences.applied, time_ms = now, boot_ms = boot_ms,
    declaration_sequence = sequences.declaration, matrix_sequence = sequences.matrix,
    override_sequence = sequences.override, failed = held, source = source, flags = flags, motors = motors,
    tables = math.min(count, 255), accepted = accepted,
  }
  for name, value in pairs(refused) do
    fields[name] = value
  end
  local packet = P.tunnel(companion.system, companion.component, P.pack(P.APPLIED, fields))
  mavlink:send_chan(companion.channel, P.TUNNEL, packet)
end

local function run()
  local now = millis():toint()
  if now - last_run_ms > 200 then
    in_force = nil -- the watchdog may have put its own factors in force meanwhile
  end
  last_run_ms = now
  while receive(now) do
  end
  if not arming:is_armed() then
    matrix, override_until_ms = nil, 0
    if held ~= 0 then
      held = 0
      failed_parameter:set(0)
    end
  end
  if matrix and (now >= matrix.expires_ms or now - last_packet_ms >= LINK_LOST_MS) then
    matrix = nil
  end
  if now < override_until_ms and stopped_by_pilot() then
    for motor = 1, motors do
      if channels[motor] then
        SRV_Channels:set_output_pwm_chan_timeout(channels[motor], airframe.pwm_min, STOP_MS)
      end
    end
    override_until_ms = 0
  end
  local source = apply(now)
  if held ~= 0 then
    for motor = 1, motors do
      if bit_of(held, motor) and channels[motor] then
        SRV_Channels:set_output_pwm_chan_timeout(channels[motor], airframe.pwm_min, STOP_MS)
      end
    end
  end
  local count = watchdog:get()
  if count ~= watchdog_count then
    watchdog_count, watchdog_seen_ms = count, now
  end
  report(now, source)
  ticks = (ticks + 1) % 30000
  alive:set(ticks)
end

function update()
  local good, message = pcall(run)
  if not good then
    errors = errors + 1
    -- Something we did not foresee: nothing streamed may stay in force.
    matrix, override_until_ms, in_force = nil, 0, nil
    pcall(apply, millis():toint())
    if errors % 100 == 1 then
      gcs:send_text(TEXT_WARNING, "NFF: " .. tostring(message))
    end
  end
  return update, 1
end

local function start()
  for motor = 1, motors do
    local from = motor <= 8 and 32 or 73 -- k_motor1 is function 33, k_motor9 82
    channels[motor] = SRV_Channels:find_channel(from + motor)
  end
  if dynamic then
    for motor = 1, motors do
      Motors_dynamic:add_motor(motor - 1, motor)
    end
    load(tables[0])
    assert(Motors_dynamic:init(motors), "NFF: motors not initialised: check SERVOn_FUNCTION")
  end
  mavlink:init(25, 25)
  mavlink:register_rx_msgid(P.TUNNEL)
  local mode = dynamic and "matrix and outputs" or "outputs only (FRAME_CLASS is not 17)"
  gcs:send_text(TEXT_INFO, string.format("NFF applet %d: %s, %s", VERSION, airframe.name, mode))
  return update, 1
end

return start()
