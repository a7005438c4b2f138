-- The mixer: tables by failed mask, the factors in force, and checks by which the companion knows what is stored.

local P = require("nff_protocol")
local airframe = require("nff_airframe")

local M = {}

local FRAME_CLASS_DYNAMIC = 17
local TABLES_MAX = 254
local ROW = 8 -- bytes of one motor in a table
local motors = airframe.motors

M.dynamic = param:get("FRAME_CLASS") == FRAME_CLASS_DYNAMIC

local stock = airframe.tables[0] -- of no failure: nobody replaces it
local tables = {} -- failed mask to factors (m rows of throttle, roll, pitch, yaw as int16), without the stock one
local masks = {} -- of the tables
local checks = {} -- of the tables, by mask
local checked, sum, shown = 0, 0, 0
local in_force = nil -- factors last loaded

for mask, factors in pairs(airframe.tables) do
  if mask ~= 0 then
    tables[mask] = factors
    masks[#masks + 1] = mask
  end
end
M.stock_check = P.check(stock)

local function note_check(mask)
  local check = P.table_check(mask, tables[mask])
  sum = (sum - (checks[mask] or 0) + check) % P.CHECKS
  checks[mask] = check
  return check
end

-- One table a run: no run computes many.
function M.check_next()
  if checked < #masks then
    checked = checked + 1
    if not checks[masks[checked]] then
      note_check(masks[checked])
    end
  end
end

-- Check of all tables but the stock one, and whether it is complete.
function M.tables_check()
  return sum, checked == #masks
end

-- Mask and check of one table, another at each call.
function M.show()
  if checked == 0 then
    return 0, M.stock_check
  end
  shown = shown % checked + 1
  return masks[shown], checks[masks[shown]]
end

-- Number of tables, with the stock one.
function M.count()
  return #masks + 1
end

-- Takes a table; its check, nil when it is not taken: the stock one stays, and memory is not endless.
function M.store(mask, factors)
  if mask == 0 or (not tables[mask] and #masks >= TABLES_MAX) then
    return nil
  end
  if not tables[mask] then
    masks[#masks + 1] = mask
  end
  tables[mask] = factors
  return note_check(mask)
end

-- Stock factors without the motors of a mask: what is left when no table was ever computed for it.
local function without(mask)
  local rows = {}
  for motor = 1, motors do
    local failed = (mask >> (motor - 1)) & 1 == 1
    rows[motor] = failed and ("\0"):rep(ROW) or stock:sub(ROW * motor - ROW + 1, ROW * motor)
  end
  return table.concat(rows)
end

local function put(factors)
  if factors == in_force then
    return
  end
  local loaded = motor_factor_table()
  for motor = 1, motors do
    local throttle, roll, pitch, yaw = string.unpack("<i2i2i2i2", factors, ROW * motor - ROW + 1)
    loaded:throttle(motor - 1, throttle / P.FACTOR_SCALE)
    loaded:roll(motor - 1, roll / P.FACTOR_SCALE)
    loaded:pitch(motor - 1, pitch / P.FACTOR_SCALE)
    loaded:yaw(motor - 1, yaw / P.FACTOR_SCALE)
  end
  Motors_dynamic:load_factors(loaded)
  in_force = factors
end

-- What was put in force may have been replaced by somebody else: put it again.
function M.forget()
  in_force = nil
end

local held_without, without_factors = 0, nil -- the last mask that has no table

-- Puts in force the streamed `factors`, without them the table of the motors `held`; nothing where the frame is fixed.
function M.apply(held, factors)
  if not M.dynamic then
    return
  end
  if not factors then
    factors = held == 0 and stock or tables[held]
  end
  if not factors then
    if held ~= held_without then
      held_without, without_factors = held, without(held)
    end
    factors = without_factors
  end
  put(factors)
end

-- Adds the motors of the scripted frame and loads the stock factors; raises when the firmware does not take them.
function M.start()
  if not M.dynamic then
    return
  end
  for motor = 1, motors do
    Motors_dynamic:add_motor(motor - 1, motor)
  end
  put(stock)
  assert(Motors_dynamic:init(motors), "NFF: motors not initialised: check SERVOn_FUNCTION")
end

return M
